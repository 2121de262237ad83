// Lists members of the engine: those that an assembly declares, and those that it uses. Compiled by mcs (C# 7).
//
// A line has tabs between: `declares` or `uses`, type, section (types, ctors, methods, props, fields, events, values, ops), name,
// signature, place in the sources. Signatures are written as in shared/unity/api.json, types without their namespaces. `calls`: a
// message of MonoBehaviour; `lost`: a private method of a behaviour that neither the sources nor, by its name, the engine calls.
using System;
using System.Collections.Generic;
using System.IO;
using System.Linq;
using Microsoft.CodeAnalysis;
using Microsoft.CodeAnalysis.CSharp;
using Microsoft.CodeAnalysis.CSharp.Syntax;

sealed class Members
{
    static readonly SymbolDisplayFormat TypeFormat = new SymbolDisplayFormat(
        SymbolDisplayGlobalNamespaceStyle.Omitted, SymbolDisplayTypeQualificationStyle.NameOnly, SymbolDisplayGenericsOptions.IncludeTypeParameters,
        miscellaneousOptions: SymbolDisplayMiscellaneousOptions.UseSpecialTypes);

    readonly CSharpCompilation compilation;
    readonly SortedSet<string> lines = new SortedSet<string>(StringComparer.Ordinal);
    readonly HashSet<ISymbol> referred = new HashSet<ISymbol>(SymbolEqualityComparer.Default);
    readonly List<IMethodSymbol> silent = new List<IMethodSymbol>();

    Members(CSharpCompilation compilation)
    {
        this.compilation = compilation;
    }

    public static void Write(CSharpCompilation compilation, string path)
    {
        var members = new Members(compilation);
        members.AddDeclared(compilation.Assembly.GlobalNamespace);
        foreach (SyntaxTree tree in compilation.SyntaxTrees) members.AddUsed(compilation.GetSemanticModel(tree), tree.GetRoot());
        foreach (IMethodSymbol method in members.silent)
            if (!members.referred.Contains(method)) members.AddMessage(method);
        File.WriteAllLines(path, members.lines);
    }

    static bool IsEngine(ISymbol symbol)
    {
        string space = symbol.ContainingNamespace == null ? "" : symbol.ContainingNamespace.ToDisplayString();
        return space == "UnityEngine" || space.StartsWith("UnityEngine.") || space == "UnityEditor" || space.StartsWith("UnityEditor.") || space.StartsWith("Unity.")
            || space.StartsWith("Microsoft.MixedReality.");
    }

    void AddDeclared(INamespaceOrTypeSymbol parent)
    {
        foreach (ISymbol member in parent.GetMembers())
        {
            if (member is INamespaceSymbol space) AddDeclared(space);
            else if (IsEngine(member) && IsVisible(member) && !member.IsImplicitlyDeclared) Add("declares", member, member.Locations[0]);
            else if (member is IMethodSymbol constructor && IsEngine(member) && IsVisible(member) && constructor.MethodKind == MethodKind.Constructor
                && constructor.ContainingType.TypeKind == TypeKind.Class) Add("declares", member, constructor.ContainingType.Locations[0]);
            if (member is INamedTypeSymbol type && type.TypeKind != TypeKind.Delegate) AddDeclared(type);
            if (!IsEngine(member) && member is IMethodSymbol method) CheckMessage(method);
        }
    }

    static bool IsVisible(ISymbol symbol)
    {
        for (; symbol is INamedTypeSymbol || !(symbol is INamespaceSymbol) && symbol != null; symbol = symbol.ContainingType)
        {
            if (symbol.DeclaredAccessibility != Accessibility.Public && symbol.DeclaredAccessibility != Accessibility.Protected
                && symbol.DeclaredAccessibility != Accessibility.ProtectedOrInternal) return false;
            if (symbol.ContainingType == null) break;
        }
        return true;
    }

    // Methods of a behaviour that the sources may not call.
    void CheckMessage(IMethodSymbol method)
    {
        if (method.MethodKind != MethodKind.Ordinary || method.DeclaredAccessibility != Accessibility.Private || method.IsStatic) return;
        for (INamedTypeSymbol type = method.ContainingType; type != null; type = type.BaseType)
            if (IsEngine(type) && type.Name == "MonoBehaviour") silent.Add(method);
    }

    void AddMessage(IMethodSymbol method)
    {
        string signature = Show(method.ReturnType) + " " + method.Name + "(" + string.Join(", ", method.Parameters.Select(ShowParameter)) + ")";
        lines.Add(string.Join("\t", "calls", method.ContainingType.Name, "messages", method.Name, signature, Place(method.Locations[0])));
    }

    void AddUsed(SemanticModel model, SyntaxNode root)
    {
        foreach (SyntaxNode node in root.DescendantNodes())
        {
            ISymbol symbol = model.GetSymbolInfo(node).Symbol;
            if (symbol != null) Use(symbol, node);
            if (node is ExpressionSyntax)
            {
                Conversion conversion = model.GetConversion(node);
                if (conversion.MethodSymbol != null) Use(conversion.MethodSymbol, node);
            }
            if (node is ForEachStatementSyntax loop)
            {
                ForEachStatementInfo info = model.GetForEachStatementInfo(loop);
                foreach (ISymbol one in new ISymbol[] { info.GetEnumeratorMethod, info.MoveNextMethod, info.CurrentProperty, info.DisposeMethod })
                    if (one != null) Use(one, node);
            }
            if (node is ConstructorInitializerSyntax || !(node is BaseTypeSyntax)) continue;
            var type = model.GetTypeInfo(((BaseTypeSyntax)node).Type).Type as INamedTypeSymbol;
            IMethodSymbol constructor = type == null || !IsEngine(type) ? null : type.InstanceConstructors.FirstOrDefault(each => each.Parameters.Length == 0);
            if (constructor != null) Use(constructor, node);
        }
    }

    void Use(ISymbol symbol, SyntaxNode node)
    {
        if (symbol is IMethodSymbol method)
        {
            symbol = method.ReducedFrom ?? method;
            if (method.AssociatedSymbol != null) symbol = method.AssociatedSymbol;
        }
        if (symbol is IAliasSymbol alias) symbol = alias.Target;
        symbol = symbol.OriginalDefinition;
        referred.Add(symbol);
        if (symbol is INamespaceSymbol || symbol is ITypeParameterSymbol || symbol is IArrayTypeSymbol || symbol is IParameterSymbol || symbol is ILocalSymbol) return;
        if (!IsEngine(symbol) || SymbolEqualityComparer.Default.Equals(symbol.ContainingAssembly, compilation.Assembly)) return;
        string accessors = symbol is IPropertySymbol ? AccessorsUsed(node) : null;
        Add("uses", symbol, node.GetLocation(), accessors);
        if (symbol.ContainingType != null) Add("uses", symbol.ContainingType.OriginalDefinition, node.GetLocation());
    }

    static string AccessorsUsed(SyntaxNode node)
    {
        SyntaxNode at = node;
        while (at.Parent is MemberAccessExpressionSyntax access && access.Name == at) at = access;
        if (at.Parent is AssignmentExpressionSyntax assignment && assignment.Left == at)
            return assignment.IsKind(SyntaxKind.SimpleAssignmentExpression) ? "{set}" : "{get; set}";
        bool isStep = at.Parent is PostfixUnaryExpressionSyntax || at.Parent is PrefixUnaryExpressionSyntax prefix
            && (prefix.IsKind(SyntaxKind.PreIncrementExpression) || prefix.IsKind(SyntaxKind.PreDecrementExpression));
        return isStep ? "{get; set}" : "{get}";
    }

    void Add(string verb, ISymbol symbol, Location location, string accessors = null)
    {
        string section, signature;
        string name = symbol.Name;
        var home = symbol.ContainingType;
        if (symbol is INamedTypeSymbol type)
        {
            section = "types";
            home = type;
            name = "";
            signature = DescribeType(type);
        }
        else if (symbol is IMethodSymbol method)
        {
            bool isKnown = method.MethodKind == MethodKind.Constructor || method.MethodKind == MethodKind.Ordinary
                || method.MethodKind == MethodKind.UserDefinedOperator || method.MethodKind == MethodKind.Conversion;
            if (!isKnown) return; // of enums, delegates, accessors
            if (method.IsOverride && method.OverriddenMethod != null && !IsEngine(method.OverriddenMethod)) return; // of System.Object
            section = method.MethodKind == MethodKind.Constructor ? "ctors" : method.MethodKind == MethodKind.Ordinary ? "methods" : "ops";
            if (section == "methods") signature = ShowMethod(method);
            else if (section == "ops") signature = Show(method.ReturnType) + " " + ShowParameters(method.Parameters);
            else signature = (method.DeclaredAccessibility == Accessibility.Protected ? "protected " : "") + ShowParameters(method.Parameters);
            name = section == "ctors" ? "" : section == "ops" ? ShowOperator(method) : name;
        }
        else if (symbol is IPropertySymbol property)
        {
            section = "props";
            if (property.IsIndexer) name = "this[]";
            signature = ShowProperty(property, accessors);
        }
        else if (symbol is IFieldSymbol field)
        {
            bool isValue = field.ContainingType.TypeKind == TypeKind.Enum;
            section = isValue ? "values" : "fields";
            if (isValue) signature = Convert.ToString(field.ConstantValue, System.Globalization.CultureInfo.InvariantCulture);
            else signature = (field.IsStatic && !field.IsConst ? "static " : "") + Show(field.Type);
        }
        else if (symbol is IEventSymbol)
        {
            section = "events";
            signature = (symbol.IsStatic ? "static " : "") + Show(((IEventSymbol)symbol).Type);
        }
        else return;
        lines.Add(string.Join("\t", verb, FullName(home), section, name, signature, Place(location)));
    }

    static string ShowMethod(IMethodSymbol method)
    {
        string generic = method.TypeParameters.Length == 0 ? "" : "<" + string.Join(", ", method.TypeParameters.Select(each => each.Name)) + ">";
        string text = (method.IsStatic ? "static " : "") + Show(method.ReturnType) + " " + generic + ShowParameters(method.Parameters, method.IsExtensionMethod);
        foreach (ITypeParameterSymbol each in method.TypeParameters)
        {
            var limits = new List<string>();
            if (each.HasUnmanagedTypeConstraint) limits.Add("unmanaged");
            else if (each.HasValueTypeConstraint) limits.Add("struct");
            if (each.HasReferenceTypeConstraint) limits.Add("class");
            limits.AddRange(each.ConstraintTypes.Select(Show));
            if (limits.Count > 0) text += " where " + each.Name + " : " + string.Join(", ", limits);
        }
        return text;
    }

    static string ShowProperty(IPropertySymbol property, string accessors)
    {
        string text = (property.IsStatic ? "static " : "") + Show(property.Type) + " ";
        if (property.IsIndexer) text += "[" + string.Join(", ", property.Parameters.Select(ShowParameter)) + "] ";
        if (accessors != null) return text + accessors;
        bool reads = property.GetMethod != null && IsVisible(property.GetMethod), writes = property.SetMethod != null && IsVisible(property.SetMethod);
        return text + "{" + (reads ? "get" : "") + (reads && writes ? "; " : "") + (writes ? "set" : "") + "}";
    }

    static string ShowOperator(IMethodSymbol method)
    {
        switch (method.Name)
        {
            case "op_Implicit": return "implicit";
            case "op_Explicit": return "explicit";
            default: return SyntaxFacts.GetText(SyntaxFacts.GetOperatorKind(method.Name));
        }
    }

    static string ShowParameters(IEnumerable<IParameterSymbol> parameters, bool isExtension = false)
    {
        return "(" + (isExtension ? "this " : "") + string.Join(", ", parameters.Select(ShowParameter)) + ")";
    }

    static string ShowParameter(IParameterSymbol parameter)
    {
        string way = parameter.IsParams ? "params " : parameter.RefKind == RefKind.None ? "" : parameter.RefKind.ToString().ToLowerInvariant() + " ";
        return way + Show(parameter.Type) + " " + parameter.Name + (parameter.HasExplicitDefaultValue ? " =" : "");
    }

    static string Show(ITypeSymbol type)
    {
        return type.ToDisplayString(TypeFormat);
    }

    static string DescribeType(INamedTypeSymbol type)
    {
        string kind = type.TypeKind.ToString().ToLowerInvariant();
        if (type.TypeKind == TypeKind.Class) kind = (type.IsStatic ? "static " : type.IsSealed ? "sealed " : type.IsAbstract ? "abstract " : "") + "class";
        var bases = type.Interfaces.Select(Show).ToList();
        if (type.BaseType != null && type.TypeKind == TypeKind.Class && type.BaseType.SpecialType != SpecialType.System_Object) bases.Insert(0, Show(type.BaseType));
        if (type.TypeKind == TypeKind.Delegate) return "delegate " + Show(type.DelegateInvokeMethod.ReturnType) + " " + ShowParameters(type.DelegateInvokeMethod.Parameters);
        return kind + (bases.Count > 0 ? " : " + string.Join(", ", bases) : "");
    }

    static string FullName(INamedTypeSymbol type)
    {
        string name = type.Name + (type.TypeParameters.Length > 0 ? "`" + type.TypeParameters.Length : "");
        if (type.ContainingType != null) return FullName(type.ContainingType) + "." + name;
        return type.ContainingNamespace.ToDisplayString() + "." + name;
    }

    string Place(Location location)
    {
        if (location.SourceTree == null) return "";
        FileLinePositionSpan span = location.GetLineSpan();
        return Path.GetFileName(span.Path) + ":" + (span.StartLinePosition.Line + 1);
    }
}
